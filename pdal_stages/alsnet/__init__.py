"""alsNet [WM19]: PointNet++ for airborne scans, in circular batches. Applying it needs NumPy; training, PyTorch."""
