"""Long runs in little time: does memory, or the number of open files or threads, grow?"""
