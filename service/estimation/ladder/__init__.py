"""The models that a scene names, one after the other. Asks models, tare, watch; none knows it."""
