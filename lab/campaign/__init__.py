"""What all experiments share: recordings, tasks on all cores whose results are kept, goals and result pages."""
