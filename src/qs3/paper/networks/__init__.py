"""Networks that the paper compares: RS-CNN, SimpleView, and PointNet with self-attention."""
