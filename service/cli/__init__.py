"""The command `foottile`: options to calls, results to text or JSON, errors to exit codes."""
