"""The person at an arm: the session as a state machine, what is shown, the keys and the page that steer it."""
