"""`robot-client check`: what stands between a robot and a server, step by step."""
