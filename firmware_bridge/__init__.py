"""Device side: bytes to frames, frames to scans, zeroing. Independent of any network."""
