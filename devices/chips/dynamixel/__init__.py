"""Read-only driver of Dynamixel MX servos: packets of both protocols, firmwares, positions."""
