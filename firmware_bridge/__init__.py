"""What is true of the device: bytes to frames, frames to scans, zeroing. Knows no model."""
