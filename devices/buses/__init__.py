"""Wires to chips, each as one small protocol: I2C, SPI, serial line. No chip here."""
