"""Star identification: a raw star image becomes identified stars with covariances.

`finding` measures stars in an image, `identification` finds them in the catalogue; `field`, `sight`,
`camera_calibration` and `sky_plan` use the result.
"""
