"""What crosses the link: messages, values, large arguments, and the socket."""
