"""Several parts in one depth picture: class and pose of each, and what stays unexplained."""
