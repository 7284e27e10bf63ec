"""Depth pictures, and the cameras and folders that they come from."""
