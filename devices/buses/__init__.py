"""Wires to chips, each as one small protocol: I2C, SPI, serial line, GPIO. No chip here."""
