"""Buses to chips, each as a small protocol: I2C, SPI, serial line. No chip-specific code."""
