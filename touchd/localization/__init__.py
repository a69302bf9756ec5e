"""Where the fingers are in a touched frame: by the network, or on the field atlas."""
