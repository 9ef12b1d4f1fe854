"""The networks, one file each: windows of taps in, patterns in [mm] out; `named_networks` has those that ship."""
