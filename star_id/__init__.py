"""A raw star image of any camera becomes named stars with covariances: found (`finding`), named (`naming`),
and put to use."""
