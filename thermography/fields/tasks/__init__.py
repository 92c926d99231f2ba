"""What a thread or a worker of a cluster computes at a time."""
