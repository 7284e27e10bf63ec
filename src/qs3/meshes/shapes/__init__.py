"""Part of qs3."""
