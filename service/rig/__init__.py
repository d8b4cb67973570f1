"""From a scene to an open array, servo and reference sensor: real, emulated, or mixed.

Opens hardware, or emulates it, for nodes and simulations; of journals it
knows only the place of frames in flight, and it knows no network.
"""
