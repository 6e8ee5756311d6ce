"""The experiments: networks trained and evaluated one after another, on one thread, at equal CPU minutes."""
