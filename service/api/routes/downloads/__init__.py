"""Downloads: in any format, a slice, a take, several sessions."""
