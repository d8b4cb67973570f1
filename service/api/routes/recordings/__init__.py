"""What was recorded, and what is known of it: sessions, takes, marks, pictures, proofs."""
