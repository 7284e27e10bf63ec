"""The simulated camera's matcher beside a real camera's own depth."""
