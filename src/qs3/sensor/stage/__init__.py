"""What a camera sees: the object's size and pose, its surroundings, and places of the cameras."""
