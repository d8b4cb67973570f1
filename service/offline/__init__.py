"""What people run at a desk: simulate, estimate, calibrate, doctor, and a client of the server."""
