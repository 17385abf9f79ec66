"""What the ground is made of by place: hard rock or soil, and the soil's parameters."""
