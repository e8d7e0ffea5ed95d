"""Exchange datasets and policies with other programs: stores, MCAP, checks and repairs."""
