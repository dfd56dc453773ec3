"""What is remembered about a kind of task on a site."""
