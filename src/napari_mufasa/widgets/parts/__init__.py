"""What steps are made of: forms, plots, tables, pages."""
