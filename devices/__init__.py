"""What the hardware is and how it is asked, and its register-level emulation."""
