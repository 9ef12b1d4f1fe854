"""The pad under tangential load: how the layer gives way to traction, and where a contact sticks or slips."""
