"""What can be identified of joints, and patterns and groups that name them."""
