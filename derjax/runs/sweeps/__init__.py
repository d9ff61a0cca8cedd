"""A scene at many values of its keys: what varies, the points, their results and a figure."""
