"""OpenSim writer: loads of each foot as rows without gaps, and their files."""
