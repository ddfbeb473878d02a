"""What couples bodies: measures of points under laws, and what a step asks of them."""
