"""The commands of `foottile`, a module for each: options to calls, results to text or JSON."""
