"""What was recorded, as files: in any format, a slice, a take, several at once."""
