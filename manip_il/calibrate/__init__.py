"""What a simulated arm needs to know of a real one, found in a recorded dataset."""
