"""One source of chance: named streams of one seed, and the variates that compiled loops draw."""
