"""From a source through the runtime into sinks."""
