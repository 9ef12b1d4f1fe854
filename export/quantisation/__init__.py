"""Networks in 8-bit integers: rounded in torch, trained a little more, quantised."""
