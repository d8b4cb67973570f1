"""What files prove of themselves, without any server and without writing anything."""
