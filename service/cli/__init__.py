"""The command line `foottile`: entry point, shared options, reports, errors to exit codes."""
