"""The networks of the paper, and how they are trained and evaluated."""
