"""MATLAB writer: a variable for each quantity of a session, or structs of several sessions."""
