"""The live page: what the loop hears, sampled and shown in browsers."""
