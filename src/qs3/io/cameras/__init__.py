"""Frames of a depth camera: live, from its recordings, and from folders."""
