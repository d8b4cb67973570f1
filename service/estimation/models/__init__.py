"""The model ladder: one module per effect, used where a scene names it."""
