"""What operations.py times: cases beside peers, by kind, and the page that is made of them."""
