"""From a scene to an open array, servo and reference sensor: real, emulated, or mixed.

Opens hardware, or emulates it, for nodes and simulations; knows no journal but the place of frames in
flight, and no network.
"""
