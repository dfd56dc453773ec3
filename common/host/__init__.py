"""What a computer reports about itself: CPU time, load, capacity."""
