"""What the foot stands on: forces and angle over time, notes, and the mill with its converter."""
