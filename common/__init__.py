"""What robot and cloud must agree on, and nothing else."""

VERSION = "0.1.0"
