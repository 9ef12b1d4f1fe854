"""Live page: results and events of the loop, sampled and shown in browsers."""
