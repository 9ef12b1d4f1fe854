"""The networks, one file each: windows of taps in, patterns in [mm] out; `registry` says which ones ship."""
