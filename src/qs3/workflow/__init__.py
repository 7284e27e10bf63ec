"""What a user does in one call: from CAD and unlabelled scans to a classifier and its answers."""
