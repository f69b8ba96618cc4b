"""Long work and shared state: jobs, the session of a viewer, live values."""
