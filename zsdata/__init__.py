"""zsdata: single photographs in, an endless, reproducible stream of stereo training pairs out."""

from zsdata.augment import AugmentConfig
from zsdata.faults import BadPhoto, BadShard, FailureBudget, NoUsablePhoto, SampleFailed, TooManyFaults, WorkerLost
from zsdata.licences import NonCommercialModel
from zsdata.loader import StereoLoader
from zsdata.losses import zero_stereo_loss
from zsdata.quality import QualityGate
from zsdata.sample import Masks, StereoBatch
from zsdata.source.archive import read_shard
from zsdata.source.photo import decode_photo
from zsdata.sources import ImageSource
from zsdata.stream import ZeroStereoStream
from zsdata.synthesis.backward_warp import backward_warp
from zsdata.synthesis.confidence import flip_confidence, normalize_inverse_depth
from zsdata.synthesis.depth import DepthNetwork, load_depth
from zsdata.synthesis.disparity import AdaptiveDisparity, UniformDisparity, dilate_disparity, sharpen_disparity
from zsdata.synthesis.inpaint import DiffusionNetwork, load_inpainter
from zsdata.synthesis.synthesizer import SynthesisConfig
from zsdata.synthesis.view import ViewConfig
from zsdata.synthesis.warp import Warped, forward_warp

__version__ = "0.1.0"

__all__ = [
    "AdaptiveDisparity",
    "AugmentConfig",
    "BadPhoto",
    "BadShard",
    "DepthNetwork",
    "DiffusionNetwork",
    "FailureBudget",
    "ImageSource",
    "Masks",
    "NoUsablePhoto",
    "NonCommercialModel",
    "QualityGate",
    "SampleFailed",
    "StereoBatch",
    "StereoLoader",
    "SynthesisConfig",
    "TooManyFaults",
    "UniformDisparity",
    "ViewConfig",
    "Warped",
    "WorkerLost",
    "ZeroStereoStream",
    "backward_warp",
    "decode_photo",
    "dilate_disparity",
    "flip_confidence",
    "forward_warp",
    "load_depth",
    "load_inpainter",
    "normalize_inverse_depth",
    "read_shard",
    "sharpen_disparity",
    "zero_stereo_loss",
]
