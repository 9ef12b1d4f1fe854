"""Pipeline from a source through the runtime into sinks."""
