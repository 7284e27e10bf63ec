"""Textbook forms of the networks, to compare with: plain layers, every edge and group stored."""
