"""What happened to a machine between two flights, or over many."""
