"""References that depend on the running estimate, and the search for them. The rest of the policy is the runtime's."""
