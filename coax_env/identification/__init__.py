"""A vehicle's own numbers from flights: by maximum likelihood, or by the paper's two steps."""
