"""Frame augmentation (section 4.1): deblurring, interpolation (10)-(13), and kalux's own bridge between frames."""
