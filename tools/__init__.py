"""What developers run on this project."""
