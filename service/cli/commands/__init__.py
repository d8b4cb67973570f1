"""One module for each command: options to calls, results to text or JSON."""
