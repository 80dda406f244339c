"""Star identification: from the pixel coordinates of detections to stars of the catalogue.

`identify` runs the search; read it first. It takes candidate attitudes from `proposals` (triangles of
detections looked up in `triangle_index`), extends each to the whole image (`hypothesis`) and accepts one by
its likelihood ratio (`likelihood`). All work in the tangent plane of the camera (`tangent_plane`).
"""
