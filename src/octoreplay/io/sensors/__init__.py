"""From message objects to arrays: images, point clouds, cameras and labels."""
