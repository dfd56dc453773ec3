"""What robot and cloud must agree on, and nothing else."""

VERSION = "0.2.0"
