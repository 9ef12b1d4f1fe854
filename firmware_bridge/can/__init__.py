"""CAN adapters: their protocols, and what goes wrong on the bus. No I/O."""
