"""What a bench recording says before and beside the fit: strokes, loadings, checks. No fit here."""
