"""What people read: numbers and durations in words."""
