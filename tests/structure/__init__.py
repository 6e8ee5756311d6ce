"""How the library is put together: who imports whom, what is public, what an import costs."""
