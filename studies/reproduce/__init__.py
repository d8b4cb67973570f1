"""Reproduction of the paper's experiments on emulated hardware, with comparison and figures."""
