"""What travels between the rooms: plain values without algorithms."""
