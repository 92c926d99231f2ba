"""Checks by which the instruments, the logs and physics must agree, before a cause is named."""
