"""What only the notebooks need: figures, checks, sliders and small CMDPs. No other package imports it."""
