"""MATLAB's .mat: quantities of a session as its numbers, a variable each, or structs of several."""
