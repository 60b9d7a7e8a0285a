"""What only the notebooks use: figures, checks, sliders and small worlds. Nothing else imports it."""
