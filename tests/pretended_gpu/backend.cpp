// What torch's CPU build lacks to hold tensors of the device "cuda": a device guard and hooks, which have nothing to do here.
// It is preloaded: torch looks for the hooks once, before Python could load anything.
#include <ATen/detail/CUDAHooksInterface.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>

namespace {

const c10::Device gpu(c10::DeviceType::CUDA, 0);
const c10::Stream stream(c10::Stream::DEFAULT, gpu);

struct Guard final : public c10::impl::DeviceGuardImplInterface {
  c10::DeviceType type() const noexcept override { return gpu.type(); }
  c10::Device exchangeDevice(c10::Device) const noexcept override { return gpu; }
  c10::Device getDevice() const noexcept override { return gpu; }
  void setDevice(c10::Device) const noexcept override {}
  void uncheckedSetDevice(c10::Device) const noexcept override {}
  c10::Stream getStream(c10::Device) const noexcept override { return stream; }
  c10::Stream exchangeStream(c10::Stream) const noexcept override { return stream; }
  c10::DeviceIndex deviceCount() const noexcept override { return 1; }
  bool queryStream(const c10::Stream&) const noexcept override { return true; }
  void synchronizeStream(const c10::Stream&) const noexcept override {}
};

struct Hooks final : public at::CUDAHooksInterface {
  explicit Hooks(at::CUDAHooksArgs) {}
  void init() const noexcept override {}
  bool hasCUDA() const noexcept override { return true; }
  bool isBuilt() const noexcept override { return true; }
  bool isAvailable() const noexcept override { return true; }
  bool hasPrimaryContext(c10::DeviceIndex) const noexcept override { return true; }
  c10::DeviceIndex deviceCount() const noexcept override { return 1; }
  c10::DeviceIndex getCurrentDevice() const noexcept override { return 0; }
  c10::DeviceIndex current_device() const noexcept override { return 0; }
  int getNumGPUs() const noexcept override { return 1; }
  bool isPinnedPtr(const void*) const noexcept override { return false; }
};

c10::impl::DeviceGuardImplRegistrar registrar(c10::DeviceType::CUDA, new Guard());

}  // namespace

namespace at {
C10_REGISTER_CLASS(CUDAHooksRegistry, CUDAHooks, ::Hooks)
}
