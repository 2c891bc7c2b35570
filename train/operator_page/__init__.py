"""A person at the arm: the session of episodes as a state machine, and the page that shows and steers it."""
