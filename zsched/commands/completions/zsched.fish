function __zsched_complete
    set -l words (commandline -opc)
    set -l last (commandline -ct)
    $words[1] complete -- $words[2..-1] "$last" 2>/dev/null
end
complete -c zsched -a '(__zsched_complete)'
