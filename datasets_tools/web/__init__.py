"""Pages on this machine for one person: who may reach them, the server in a thread, routes that every page has."""
