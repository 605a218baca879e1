"""What the inpainting U-Net learns from: true right images, and what a left view could and could not tell of them."""
