"""Tools of the developers: the argument of the shield, checked by machine."""
