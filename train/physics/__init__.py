"""The simulated pad: contact and friction on its layer, movement of its magnets, readings of its taxels."""
