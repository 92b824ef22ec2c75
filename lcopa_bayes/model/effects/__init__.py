"""Named physical effects that a linear plant may lack, one module per place where they act."""
