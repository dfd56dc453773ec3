"""What robot and cloud must agree on."""

VERSION = "0.2.0"
