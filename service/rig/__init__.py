"""Rig of a scene: open array, servo and reference sensor, real, emulated, or mixed.

For nodes and simulations. It uses no network, and of the journals only the file of frames in
flight.
"""
