"""Everything that tells: words, figures, plots, the HTML report."""
