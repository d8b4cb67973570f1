"""What the foot stands on: forces on the domes as a function of time, and nothing else."""
