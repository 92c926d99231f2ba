"""Registration of thermograms to the table plan: fiducials, lens model, displacement and motion of the table, and the camera's clock."""
