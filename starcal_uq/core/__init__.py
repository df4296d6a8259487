"""What knows no star: types, errors, status, files, records, times, tasks."""
