"""What keeps rods apart, and the friction between them."""
