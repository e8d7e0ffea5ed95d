"""What moves datasets and policies to and from other programs: stores, MCAP, checks and repairs."""
