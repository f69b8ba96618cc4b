"""From light to emitted photons: rates, Markov chains, and the two engines that run them."""
