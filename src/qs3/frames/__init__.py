"""Depth pictures, infrared pairs and masks, and the cameras and folders that they come from."""
