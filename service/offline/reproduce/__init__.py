"""The paper's experiments on emulated hardware: what is pressed, recorded, compared and drawn."""
