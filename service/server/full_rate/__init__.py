"""Every frame of a node, live, for programs: what is in memory, what comes next, as Arrow."""
