"""`cqn-data review`: a page to look at a recording and to decide what becomes of it."""
