"""Speed against error: every rung of the model ladder, over many draws of an emulated scene."""
